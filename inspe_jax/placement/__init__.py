"""The search for better places: what mounting allows, methods, cost and tolerance."""
