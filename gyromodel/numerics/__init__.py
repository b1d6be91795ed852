"""Pure functions that know nothing of gyros."""
