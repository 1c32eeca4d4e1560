"""What the product does in a second, beside the ceiling measured in the same run."""

import os

PEER_ENVIRONMENT = dict(os.environ)  # as it came: a peer takes as many threads as it would

# before numpy is imported: one thread each, as the roles' processes have it
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
