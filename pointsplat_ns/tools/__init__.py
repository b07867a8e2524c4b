"""Tools around the mission: levels, pages, films, folders, the trade-off."""
