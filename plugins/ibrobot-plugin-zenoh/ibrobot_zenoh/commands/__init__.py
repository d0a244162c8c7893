"""The commands `ibrobot topic …` and `ibrobot certs`."""
