"""Three-key DoorKey."""
