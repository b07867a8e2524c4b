"""What a program does beside its task: show how far it is, keep the memory that it freed."""
