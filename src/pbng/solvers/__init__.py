"""Solvers: each a set-up and one sweep; the loop, the budget and the report are common."""
