"""The shadow maps by name: what each stores, and how it turns that into visibility."""
