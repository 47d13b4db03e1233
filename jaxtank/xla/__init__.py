"""What the compiler has to be asked for; each module names the version that made it necessary."""
