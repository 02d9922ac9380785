"""What is at the other end of the cables: drives over Modbus, a phone over a socket."""
