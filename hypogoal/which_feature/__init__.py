"""WhichFeature (Spec H1): a benchmark of hypothesis learning whose answer is known, because its features are planted."""
