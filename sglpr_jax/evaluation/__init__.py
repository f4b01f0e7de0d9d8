"""Evaluation of descriptors: protocols, scoring, tables, figures and HTML pages."""
