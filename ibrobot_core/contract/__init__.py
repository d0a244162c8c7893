"""The contract: how topics become tensors and actions become messages, the same live and offline."""
