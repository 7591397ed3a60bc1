"""What found gains and grids are worth: verification, limits of stability, maps, the paper's claims."""
