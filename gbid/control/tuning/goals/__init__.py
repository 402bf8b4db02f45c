"""Goals of a design as values: objectives and limits of damping, responses, margins, noise and piezo travel."""
