"""`ibrobot gamepad …`: lists, tests and maps gamepads and SpaceMice; one class per command."""
