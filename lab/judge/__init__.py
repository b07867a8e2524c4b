"""The judge: what pruned and compacted scenes lose in views that were written by hand, and in
held-out photos."""
