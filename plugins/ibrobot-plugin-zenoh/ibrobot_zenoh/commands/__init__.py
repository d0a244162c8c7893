"""The commands `ibrobot topic …`, `ibrobot service …` and `ibrobot certs`."""
