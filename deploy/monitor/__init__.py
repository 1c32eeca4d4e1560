"""What a run says of itself: terminal, metrics log, attaching."""
