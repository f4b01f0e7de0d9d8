"""From a descriptor file to numbers and pictures: protocols, report, figures, and baselines to compare with."""
