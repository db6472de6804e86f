"""Measurements, `python -m bench` in a checkout; no part of the wheel."""
