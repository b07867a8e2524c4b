"""The paper's Tables 1 to 4 and Figure 4 on any scenes: what is in them, measuring it cell by cell, and writing it."""
