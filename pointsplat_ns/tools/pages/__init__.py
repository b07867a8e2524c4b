"""HTML pages in one file each, which open offline: templates, scripts, pictures and security
policy."""
