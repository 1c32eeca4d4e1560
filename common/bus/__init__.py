"""How roles reach each other: the protocol, and its two implementations."""
