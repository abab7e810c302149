"""The tables and figures of Shin et al. 2019, reproduced and compared with the paper's numbers."""
