"""The public benchmark of diagnoses: hidden effects on machines whose formulas are not those of the catalogue."""
