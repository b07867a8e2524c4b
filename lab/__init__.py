"""Programs that measure the package and its tests; README.md says which one to run when."""
