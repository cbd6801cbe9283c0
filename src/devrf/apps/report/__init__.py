"""Tables and plots of finished runs, beside the paper's own. Needs no torch."""
