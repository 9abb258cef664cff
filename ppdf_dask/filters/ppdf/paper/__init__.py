"""PPDF as published: the paper profile."""
