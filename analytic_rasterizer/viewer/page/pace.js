// How large pictures may be while the camera moves, by the time that they take.

const SLOW = 50, QUICK = 12;  // ms
const SMALLEST = 8;           // 1/8 of the width and height
const GAIN = 0.75;            // of the time, at most, after a step that is worth its pixels
const SAMPLES = 4;            // of a picture at rest, as a guess, for one in motion

export class Pace {
  /// `settled` is what the last picture at rest took, of all pixels and samples [ms].
  constructor(settled) {
    this.divisor = 1;
    this.times = new Map();  // ms by divisor
    for (let time = settled / SAMPLES; time > SLOW && this.divisor < SMALLEST; time /= 4) this.divisor *= 2;
  }

  note(milliseconds) {
    const { divisor, times } = this, old = times.get(divisor) ?? milliseconds;
    const now = 0.5 * (old + milliseconds), next = 2 * divisor, last = divisor / 2;
    times.set(divisor, now);
    const gains = (from, to) => !times.has(from) || !times.has(to) || times.get(to) < GAIN * times.get(from);
    if (now > SLOW && divisor > 1 && !gains(last, divisor)) this.divisor = last;
    else if (now > SLOW && next <= SMALLEST && gains(divisor, next)) this.divisor = next;
    else if (now < QUICK && divisor > 1) this.divisor = last;
  }
}
