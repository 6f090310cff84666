"""One self-contained HTML page on runs, evaluations and sweeps. Nothing here imports PyBullet."""
