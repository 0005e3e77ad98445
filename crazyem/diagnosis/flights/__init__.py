"""A recorded flight as arrays: rows in free flight, what the rotors were told, what belongs to that recording alone."""
