"""Warp code only: what runs on the device."""
