"""Results on disk: labelled arrays in netCDF."""
