"""Sub-goals in Montezuma's Revenge (Spec B4, B5)."""
