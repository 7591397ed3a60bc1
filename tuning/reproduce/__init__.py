"""The paper's three cases walked again, and what becomes of its claims: what `mjx-climb reproduce` does."""
