"""The networks again, in compiled passes over bfloat16 products, and the kernel of every CPU's Adam."""
