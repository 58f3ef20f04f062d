"""What is told of a search and of a precheck: words, tables, figures, a section of the page."""
