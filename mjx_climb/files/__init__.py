"""Results on disk: labelled arrays in netCDF, and copies of the files that a scenario names."""
