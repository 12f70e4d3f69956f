"""Weather to disk: offline data sets."""
