// UART, 8 bits, no parity: bytes in and out of a serial line.
//
// `DIVISOR` clocks a bit, at least 2. A bit is looked at in its middle, or up to a clock later. A start bit must last
// that long; a byte without a stop bit is dropped.
`default_nettype none
module uart #(
    parameter DIVISOR = 4
) (
    input  wire       clk,
    input  wire       rst,
    input  wire       rx,
    output wire       tx,
    output reg  [7:0] rx_data,
    output reg        rx_valid,
    input  wire [7:0] tx_data,
    input  wire       tx_valid,
    output wire       tx_ready
);
  localparam BITS = $clog2(DIVISOR);
  localparam [BITS-1:0] LAST = DIVISOR - 1, MIDDLE = DIVISOR / 2 - 1;

  reg [1:0] synced;
  always @(posedge clk) synced <= rst ? 2'b11 : {synced[0], rx};
  reg [BITS-1:0] in_wait;
  reg [3:0] in_bit;  // 0: idle; 1: start; 2 to 9: data; 10: stop
  always @(posedge clk) begin
    rx_valid <= 0;
    if (rst) in_bit <= 0;
    else if (in_bit == 0) begin
      in_wait <= MIDDLE;
      if (!synced[1]) in_bit <= 1;
    end else if (in_wait != 0) in_wait <= in_wait - 1'b1;
    else begin
      in_wait <= LAST;
      in_bit  <= in_bit + 1'b1;
      if (in_bit == 1 && synced[1]) in_bit <= 0;
      else if (in_bit == 10) begin
        in_bit   <= 0;
        rx_valid <= synced[1];
      end else if (in_bit != 1) rx_data <= {synced[1], rx_data[7:1]};
    end
  end

  reg [9:0] shift;
  reg [3:0] out_bits;
  reg [BITS-1:0] out_wait;
  initial shift = 10'h3FF;
  assign tx = shift[0];
  assign tx_ready = out_bits == 0;
  always @(posedge clk)
    if (rst) begin
      shift <= 10'h3FF;
      out_bits <= 0;
    end else if (out_bits == 0) begin
      if (tx_valid) begin
        shift <= {1'b1, tx_data, 1'b0};
        out_bits <= 4'd10;
        out_wait <= LAST;
      end
    end else if (out_wait != 0) out_wait <= out_wait - 1'b1;
    else begin
      shift <= {1'b1, shift[9:1]};
      out_bits <= out_bits - 1'b1;
      out_wait <= LAST;
    end
endmodule
`default_nettype wire
