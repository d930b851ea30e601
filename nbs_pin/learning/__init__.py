"""Controllers trained through the closed loop; torch is at home here."""
