// What the watchdog promises, for any commands. Part of watchdog.v, to be proven by yosys-smtbmc with a short millisecond.
localparam CLKS_PER_MS = CLKS_PER_US * US_PER_MS;
reg begun = 0;
reg [15:0] silent = 0;  // clocks since the last command
reg held_before = 0, heard_before = 0, off_before = 1, time_passed = 0;
reg [31:0] time_before = 0;
reg [15:0] hold_before = 0;
wire off = rst || !enabled;
wire [15:0] ticks = us + US_PER_MS * silent_ms;
always @(posedge clk) begin
  begun <= 1;
  silent <= off || heard ? 0 : silent + (silent != 16'hFFFF);
  held_before <= held;
  heard_before <= heard;
  off_before <= off;
  hold_before <= hold_after_ms;
end
always @* begin
  assume (rst == !begun);
  assume (hold_after_ms <= 3);
  assume (!begun || hold_after_ms == hold_before);  // a board ties it
  if (begun) begin
    in_time: assert (held || silent <= (hold_after_ms + 2) * CLKS_PER_MS);
    not_early: assert (!held || silent > hold_after_ms * CLKS_PER_MS);
    stays: assert (!held_before || held || heard_before || off_before);
    wakes: assert (!(heard_before || off_before) || !held);
    a_pre: assert (pre < CLKS_PER_US && us < US_PER_MS);
    a_most: assert (silent_ms <= hold_after_ms + 1);
    a_held: assert (!held || silent_ms > hold_after_ms);
    a_due: assert (held || silent_ms <= hold_after_ms || (us == 0 && silent <= (hold_after_ms + 1) * CLKS_PER_MS + 1));
    if (!held) begin
      a_low: assert (silent + CLKS_PER_US > ticks * CLKS_PER_US);
      a_high: assert (silent <= ticks * CLKS_PER_US + pre);
    end else a_silent: assert (silent > hold_after_ms * CLKS_PER_MS);
  end
end
