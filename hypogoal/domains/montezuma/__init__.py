"""Sub-goals in Montezuma's Revenge."""
