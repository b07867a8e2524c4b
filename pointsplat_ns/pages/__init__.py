"""Pages in one HTML file each, which open offline from a double click: their look, their pictures, their safety."""
