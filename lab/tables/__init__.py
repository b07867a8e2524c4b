"""The paper's Tables 1 to 4 and Figure 4 on any scenes: rows, measurement of cells, and output."""
