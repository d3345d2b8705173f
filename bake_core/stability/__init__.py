"""Stiff and extreme cases with known answers, and the one call that runs them."""
