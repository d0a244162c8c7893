"""`ibrobot plan` and `ibrobot description`."""
