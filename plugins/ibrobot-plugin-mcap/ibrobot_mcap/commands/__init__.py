"""`ibrobot episodes …` and `ibrobot contract …`: manage recorded episodes; one file per command."""
