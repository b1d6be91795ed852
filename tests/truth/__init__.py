"""Independent simulators that hide effects in tests: numpy and scipy only, no code shared with the package."""
