"""What nerfstudio's entry points name. Empty on purpose: importing one specification must not
import the other."""
