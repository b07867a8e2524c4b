"""Programs that measure the package and its tests. README.md says which one to run when. The package never imports them."""
