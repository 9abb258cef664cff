"""PPDF, robust profile: the default."""
