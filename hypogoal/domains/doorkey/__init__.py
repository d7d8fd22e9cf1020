"""Three-key DoorKey (Spec B1-B3)."""
