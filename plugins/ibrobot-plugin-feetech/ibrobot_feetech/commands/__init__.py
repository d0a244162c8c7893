"""`ibrobot feetech …`: sets up, calibrates and inspects the servos of an arm; one file per command."""
