"""Common basis of every fit: readings, noise, whitening, outliers, held-out runs."""
