"""Trained scenes: beside another trainer, and what they tell of where their photos were taken."""
