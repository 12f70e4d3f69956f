"""A frame gets the weather's background."""
