"""Diagnosis of ball-bar tests: [BB]'s parameters and what they leave out."""
