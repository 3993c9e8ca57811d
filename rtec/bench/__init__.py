"""The public benchmark of diagnoses: hidden effects on machines that share no formula with the catalogue."""
