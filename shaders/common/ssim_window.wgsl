// The window of the structural similarity: a Gaussian of sigma 1.5 pixels along one axis; its sum is 1.
const WINDOW = array<f32, 11>(
    0.0010283801, 0.0075987582, 0.036000773, 0.10936069, 0.21300553, 0.26601172,
    0.21300553, 0.10936069, 0.036000773, 0.0075987582, 0.0010283801);
#import common/constants
