"""HTTP servers: `listener`, `guard`, `server`, `files`, `certificates`, and `probes`, a port for monitoring.

Importing this package, `ibrobot_http.addresses` or `ibrobot_http.certificates` does not import aiohttp.
"""
