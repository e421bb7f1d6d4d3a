"""Shipped model of the policy `learned`; `goal.md` is its card."""
