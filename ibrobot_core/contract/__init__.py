"""The contract: how topics become tensors and actions become messages, identically live and offline."""
