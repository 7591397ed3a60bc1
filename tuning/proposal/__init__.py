"""What a robot's file suggests for a scenario: limbs, feet, a stance that is searched, gait and gains in proportion."""
