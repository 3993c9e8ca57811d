"""From a requested correction to counts: guard, ledger, sinks, quadrature, pulse insertion."""
