"""The installed code that results depend on, and folders of results with one owner at a time."""

from ibrobot_provenance.code import differing_code, installed_code
from ibrobot_provenance.ownership import Ownership, owned

__all__ = ["Ownership", "differing_code", "installed_code", "owned"]
