"""Files of users and results: keys, schemas, tables, NetCDF."""
