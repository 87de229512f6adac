// How large pictures may be while the camera moves, by the time that they take.

const SLOW = 50, QUICK = 12;  // ms
const SMALLEST = 8;           // 1/8 of the width and height
const GAIN = 0.75;            // of the time, at most, after a step that is worth its pixels

export class Pace {
  constructor() {
    this.divisor = 1;
    this.times = new Map();  // ms by divisor
  }

  /// Takes note of what a picture took at the divisor.
  note(milliseconds) {
    const { divisor, times } = this, old = times.get(divisor) ?? milliseconds;
    const now = 0.5 * (old + milliseconds), next = 2 * divisor, last = divisor / 2;
    times.set(divisor, now);
    const gains = (from, to) => !times.has(to) || times.get(to) < GAIN * times.get(from);
    if (now > SLOW && divisor > 1 && !gains(last, divisor)) this.divisor = last;
    else if (now > SLOW && next <= SMALLEST && gains(divisor, next)) this.divisor = next;
    else if (now < QUICK && divisor > 1) this.divisor = last;
  }
}
