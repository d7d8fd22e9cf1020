"""WhichFeature (Spec H1): a benchmark of hypothesis learning with a known answer: its features are planted."""
