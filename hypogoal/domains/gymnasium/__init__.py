"""Domains made of a Gymnasium environment."""
