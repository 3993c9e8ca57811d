"""`rtec demo`: a simulated turning centre over a day, uncorrected and corrected, from measuring to report."""
