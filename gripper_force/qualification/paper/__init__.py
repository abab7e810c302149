"""The tables and figures of Shin et al. 2019, made again and set beside the paper's own numbers."""
