"""Reports: pages and their figures."""
