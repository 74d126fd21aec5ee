"""All shadow maps on scenes that are hard for them."""
