"""Largest plausible numbers."""

FURTHEST = 1000.0
"""Positions [m] and angles [rad] beyond this are refused as mistakes; distances to them are not computed well."""
