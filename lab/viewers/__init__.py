"""Who opens what: files in the programs that draw them, beside the pictures of this package."""
