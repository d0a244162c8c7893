"""`ibrobot camera …`: lists and previews cameras; one file per command."""
