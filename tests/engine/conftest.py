import os
import sys
from pathlib import Path

# For `units_of_work` and `driver`, which hold no tests; workers of either engine import the first.
HERE = str(Path(__file__).parent)
sys.path.append(HERE)
os.environ["PYTHONPATH"] = os.pathsep.join([HERE, *filter(None, [os.environ.get("PYTHONPATH")])])
