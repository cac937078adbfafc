"""Many runs from one study file: samples, planning, execution, collection."""
