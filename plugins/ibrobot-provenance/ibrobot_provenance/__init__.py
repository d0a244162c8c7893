"""The installed code that results depend on."""

from ibrobot_provenance.code import differing_code, installed_code

__all__ = ["differing_code", "installed_code"]
