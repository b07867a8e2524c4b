"""The paper's tables on any scenes.

python -m lab.tables outputs/fox/splatfacto-cpu/RUN room.ply -o tables
"""

from lab.common.printing import start
from lab.tables.measure import measure_tables

if __name__ == "__main__":
    start(measure_tables)
