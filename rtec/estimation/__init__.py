"""What every fit stands on: readings, noise, whitening, outliers, held-out runs."""
