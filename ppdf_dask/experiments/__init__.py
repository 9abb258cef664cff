"""Comparisons and studies as pure functions: data in, tables and figures out; the command line prints and saves."""
