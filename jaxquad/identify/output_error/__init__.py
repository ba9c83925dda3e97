"""Fits and verification in the time domain."""
