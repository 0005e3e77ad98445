"""A recorded flight as arrays: rows in free flight, inputs of the rotors, nuisances of the recording."""
