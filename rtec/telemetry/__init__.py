"""The status of a running daemon in the network of a shop: processes that only read it, one a protocol."""
