"""The paper's three cases walked again, with verdicts on its claims: `mjx-climb reproduce`."""
