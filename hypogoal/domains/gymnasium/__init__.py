"""Domains made of a Gymnasium environment (Spec B6, B7)."""
