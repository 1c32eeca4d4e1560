"""An update on a CPU with bfloat16 products: the networks and Adam again, in compiled passes."""
