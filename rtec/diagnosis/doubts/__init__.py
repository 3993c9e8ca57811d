"""Doubts about the record: what to correct, or to measure differently, before an effect is blamed."""
