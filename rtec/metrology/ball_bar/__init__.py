"""Diagnosis of ball-bar tests: [BB]'s parameters, and causes beyond them."""
