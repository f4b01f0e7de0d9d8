"""From descriptors to numbers and pictures: protocols, one call that scores, tables, figures and pages."""
