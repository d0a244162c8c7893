"""The commands `ibrobot topic …`, `ibrobot service …`, `ibrobot bag …` and `ibrobot certs`."""
