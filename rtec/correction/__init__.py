"""From a wanted correction to counts: guard, ledger, sinks, quadrature, pulse insertion."""
