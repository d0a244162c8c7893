"""Feetech STS servos: packets of the bus and the control table of the STS3215."""
