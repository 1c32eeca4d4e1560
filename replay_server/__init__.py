"""The replay server: a committed ring of windows, prioritized sampling, and the rate limiter."""
