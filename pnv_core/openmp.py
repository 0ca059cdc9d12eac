"""How OpenMP threads wait: asleep. Imported before torch, which reads it once.

By default idle threads spin between two parallel regions, on cores that the camera driver or another process could use;
with two busy processes on two cores that made a description several times slower.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
