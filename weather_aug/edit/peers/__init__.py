"""Other editors of backgrounds, to compare with."""
