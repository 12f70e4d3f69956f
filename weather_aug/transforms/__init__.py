"""Weather on the fly: datasets and the transforms of host libraries."""
