"""PPDF: progressive plane detection filtering, after Cai, Liang and Yu (Forests 2023, 14(3), 498)."""
