"""One self-contained HTML page on runs, evaluations and sweeps. It needs no PyBullet, and PyTorch for little."""
