"""Tools on top of the pipeline: levels of detail, pages, films, folders, the tradeoff."""
