// A ball on a stem for the flange, and a block with two sockets 50 mm apart.
// Print the block flat and the ball stem up, at 0.1 mm layers; a bought ball of
// 10 mm, glued onto the stem, is rounder than a printed one. Lengths in mm.

ball = 10;      // diameter of the ball
play = 0.1;     // how much wider a socket is
apart = 50;     // centres of the sockets
stem = 40;      // from the flange to the ball's centre

module holder() {
  cylinder(h = 4, d = 40, $fn = 96);
  cylinder(h = stem, d1 = 12, d2 = 0.6 * ball, $fn = 96);
  translate([0, 0, stem]) sphere(d = ball, $fn = 128);
}

module sockets() {
  difference() {
    translate([-20, -20, 0]) cube([apart + 40, 40, 12]);
    for (x = [0, apart]) {
      // Less than half of the ball, so that the stem may lean by 60 degrees.
      translate([x, 0, 12 + 0.25 * ball]) sphere(d = ball + play, $fn = 128);
    }
    for (x = [-14, apart + 14]) {
      translate([x, -14, -1]) cylinder(h = 14, d = 4, $fn = 32);  // screws
    }
  }
}

sockets();
translate([0, 60, 0]) holder();
