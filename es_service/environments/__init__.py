"""Our tasks as environments of other libraries. Imports nothing of the service but `protocol`, and `workers`."""
